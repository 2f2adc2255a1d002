"""Random filter problems, the awkward ones included."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

LIMIT = 0.1574


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """`slow_with(name="joint")` on a test or a module marks those of its cases that have these parameters."""
    for item in items:
        parameters = getattr(getattr(item, "callspec", None), "params", {})
        for mark in item.iter_markers("slow_with"):
            if all(parameters.get(name) == value for name, value in mark.kwargs.items()):
                item.add_marker(pytest.mark.slow)


@dataclass
class Problems:
    """A batch: nominal (n, 2), normals (n, k, 2), offsets (n, k); `limit` is the same for all."""

    nominal: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    limit: float = LIMIT

    def __len__(self) -> int:
        return len(self.nominal)

    def cast(self, dtype: np.dtype) -> "Problems":
        return Problems(*(v.astype(dtype) for v in (self.nominal, self.normals, self.offsets)), self.limit)

    def unit_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Normals of length 1 and offsets to match; rows without a normal come out as 0.u >= c unchanged."""
        length = np.linalg.norm(self.normals, axis=2)
        length = np.where(length > 0.0, length, 1.0)
        return self.normals / length[..., None], self.offsets / length


def _directions(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _family(name: str, rng: np.random.Generator, n: int, k: int) -> Problems:
    nominal = LIMIT * rng.normal(size=(n, 2))
    angle = rng.uniform(-np.pi, np.pi, (n, k))
    offsets = LIMIT * rng.uniform(-1.1, 0.9, (n, k))
    scale = np.ones((n, k))
    copies = np.arange(1, k, 2)  # every second row is made from the one before it
    if name == "parallel":
        angle[:, copies] = angle[:, copies - 1]
    elif name == "opposed":
        angle[:, copies] = angle[:, copies - 1] + np.pi
    elif name == "equality":
        angle[:, copies] = angle[:, copies - 1] + np.pi
        offsets[:, copies] = -offsets[:, copies - 1]
    elif name == "duplicate":
        angle[:, copies] = angle[:, copies - 1]
        offsets[:, copies] = offsets[:, copies - 1]
    elif name == "nearly parallel":
        tilt = 10.0 ** rng.uniform(-15, -1, (n, len(copies)))
        angle[:, copies] = angle[:, copies - 1] + rng.choice([0.0, np.pi], tilt.shape) + tilt
        near = rng.random(tilt.shape) < 0.5
        sign = np.sign(np.cos(angle[:, copies] - angle[:, copies - 1]))
        offsets[:, copies] = np.where(near, sign * offsets[:, copies - 1], offsets[:, copies])
    elif name == "zero":
        scale[rng.random((n, k)) < 0.5] = 0.0
        offsets = np.where(
            scale == 0.0, np.where(rng.random((n, k)) < 0.8, -1.0, 1.0) * abs(offsets), offsets
        )
    elif name == "scaled":
        scale = 10.0 ** rng.uniform(-6, 6, (n, k))
    elif name == "far nominal":
        nominal = nominal * 10.0 ** rng.uniform(0, 4, (n, 1))
    elif name == "boundary":
        nominal = LIMIT * _directions(rng.uniform(-np.pi, np.pi, n))
        offsets = LIMIT * rng.choice([-1.0, 0.0, 0.5, 1.0], (n, k))
    elif name == "crowded":
        offsets = LIMIT * rng.uniform(0.2, 1.5, (n, k))
    else:
        assert name == "random"
    normals = scale[..., None] * _directions(angle)
    return Problems(nominal, normals, np.where(scale > 0.0, scale, 1.0) * offsets)


FAMILIES = (
    "random", "parallel", "opposed", "equality", "duplicate", "nearly parallel", "zero", "scaled",
    "far nominal", "boundary", "crowded",
)  # fmt: skip


@pytest.fixture
def problems() -> Callable[..., Problems]:
    """`problems(n, k, seed=0, families=FAMILIES)`: about n problems of k rows, spread over the families."""

    def make(n: int, k: int, seed: int = 0, families: tuple[str, ...] = FAMILIES) -> Problems:
        rng = np.random.default_rng([seed, k])
        parts = [_family(name, rng, -(-n // len(families)), k) for name in families]
        return Problems(
            *(
                np.concatenate([getattr(p, field) for p in parts])
                for field in ("nominal", "normals", "offsets")
            )
        )

    return make
