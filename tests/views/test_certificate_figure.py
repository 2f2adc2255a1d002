"""The certificate's figure: drawn in every case, and true to the sets."""

import numpy as np
import pytest

from sidestep.safety.certificate import certify
from sidestep.safety.sampled.flow_map import side_value
from sidestep.views import certificate_figure
from sidestep.views.certificate_figure import set_outline
from sidestep.world import load_scenario


def test_outlines_are_the_boundaries_of_the_sets():
    outline = set_outline(0.2, 0.66)
    value = np.maximum(side_value(outline, 0.66, 1.0), side_value(outline, 0.66, -1.0))
    np.testing.assert_allclose(value, 0.2, atol=1e-12)
    np.testing.assert_allclose(outline[0], [0.2 / np.cos(0.66), 0.0])
    np.testing.assert_array_equal(outline[0], outline[-1])


@pytest.mark.parametrize(
    "fields, options",
    [
        ({"evader_speed": 0.21}, {"start": (0.4, 0.2)}),
        pytest.param({"evader_speed": 0.21}, {"walls": True}, marks=pytest.mark.slow),
        pytest.param({}, {"half_axle": 0.0}, marks=pytest.mark.slow),
        ({"capture_distance": 0.17}, {"position_error": 3e-3, "delay": 0.03}),
    ],
)
def test_every_kind_of_certificate_is_drawn(fields, options, tmp_path):
    certificate = certify(load_scenario("paper", **fields), check_shield=False, **options)
    png, pdf = certificate_figure(certificate, tmp_path / "certificate")
    assert png.read_bytes().startswith(b"\x89PNG")
    assert pdf.read_bytes().startswith(b"%PDF")
