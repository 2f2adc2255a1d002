"""The benchmark: sides that do not solve the same problem, figures that mislead, a peer that is not there."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bench
from sidestep.safety.filter.projection import project
from speed import children, filter_peers, learning, process, report, roofline, scaling, timing
from speed import filter as filter_section
from speed.children import Case, run_case
from speed.figures import draw_all
from speed.filter_problems import disagreement, problems
from speed.peers import MissingPeer, peer
from speed.sections import SECTIONS, section

BENCHMARKS = Path(bench.__file__).parent


@pytest.mark.parametrize("rows", [2, 8])
def test_ours_and_the_exact_answer_agree_where_the_disc_is_not_active(rows):
    given = problems(300, rows)
    side = filter_section.make_side("ours", given)
    apart = disagreement(given, side.answers(side.batch()))
    assert apart["compared"] > 100
    assert apart["largest_difference"] < 1e-3
    assert apart["median_difference"] < 1e-6
    one = side.answer(side.single(3))
    np.testing.assert_allclose(one, side.answers(side.batch())[3], atol=1e-6)


@pytest.mark.parametrize("rows", [2, 8])
def test_the_exact_answer_is_that_of_another_solver(rows):
    """Clarabel is a test dependency anyway; it keeps the disc too."""
    given = problems(60, rows, seed=2)
    side = filter_peers.clarabel(given)
    apart = disagreement(given, side.answers(side.batch()))
    assert apart["compared"] > 20
    assert apart["largest_difference"] < 1e-4


def test_a_wrong_answer_does_not_pass_for_agreement():
    given = problems(50, 2)
    wrong = given.nominal + np.array([0.01, 0.0])
    assert disagreement(given, wrong)["largest_difference"] > 0.005


def test_the_filter_has_no_matrix_product_that_tf32_could_round():
    """TF32 changes products of matrices and convolutions alone, so an accelerator answers as a CPU does."""
    arguments = (jnp.zeros(2), jnp.ones((8, 2)), jnp.zeros(8), 0.18)
    for function in (project, jax.grad(lambda *a: project(*a).action.sum())):
        for precision in ("tensorfloat32", "highest"):
            with jax.default_matmul_precision(precision):
                program = str(jax.make_jaxpr(function)(*arguments))
            assert "argmin" in program
            assert "dot_general" not in program
            assert "conv_general" not in program


def test_operations_of_an_update_are_those_of_its_layers():
    counts = roofline.products(12, [256, 256], 256)
    total = sum(roofline.operations(product) * times for product, times in counts.items())
    actor, critic = 12 * 256 + 256 * 256 + 256 * 2, 14 * 256 + 256 * 256 + 256
    once = actor + 4 * critic + 2 * critic + 2 * (256 * 256)
    delayed = actor + critic + (256 * 256 + 2 * 256) + actor + (256 * 256 + 256 * 2)
    assert total == 2 * 256 * (once + 0.5 * delayed)


def test_products_are_timed_in_their_own_shape():
    for kind, rows, inner, columns in (("NN", 5, 3, 7), ("TN", 5, 3, 7), ("NT", 5, 3, 7)):
        a, b = roofline._operands((kind, rows, inner, columns))
        left, right = (a.T if kind == "TN" else a), (b.T if kind == "NT" else b)
        assert (left @ right).shape == (rows, columns)
    figures = roofline._rates("JAX", 0.001)
    assert {one["kind"] for one in figures["products"]} == {"NN", "TN", "NT"}
    assert 0.0 < figures["gflops"] < 1e6


def test_exponents_are_the_slopes_of_power_laws():
    sizes = [1, 2, 4, 8, 16, 32]
    assert timing.exponent(sizes, [3.0 * n**1.7 for n in sizes]) == pytest.approx(1.7)
    fixed_cost = [1.0 if n < 8 else n / 8 for n in sizes]
    assert timing.tail_exponent(sizes, fixed_cost) == pytest.approx(1.0)
    assert timing.tail_exponent([0, 1], [1.0, 1.0]) is None
    # A factor of two is no growth to speak of.
    assert timing.tail_exponent([1, 2, 3, 4], [1.0, 2.0, 3.0, 4.0]) is None
    assert timing.tail_exponent([1, 4, 16], [1.0, 4.0, 16.0]) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="two or more"):
        timing.exponent([1], [1.0])


def test_spread_names_the_worst():
    figures = timing.spread([1e-6] * 99 + [1e-3])
    assert figures["p50"] == pytest.approx(1.0)
    assert figures["p99"] == pytest.approx(1000.0)
    assert figures["worst"] == pytest.approx(1000.0)
    assert figures["count"] == 100


def test_a_missing_peer_says_what_to_install_and_pytorch_first():
    with pytest.raises(MissingPeer, match=r"pip install torch==2\.13\.0 && .*pip install .*\[bench\]"):
        peer("no_such_peer_of_ours")


def test_a_case_runs_in_a_process_of_its_own_and_survives_what_its_library_prints():
    figures = run_case(
        Case("startup", "python -c pass", {"command": "python -c pass", "repeats": 2}, threads=1)
    )
    assert figures["latency"]["count"] == 2
    assert figures["environment"]["OMP_NUM_THREADS"] == "1"
    assert figures["environment"]["PJRT_NPROC"] == "1"
    failed = run_case(Case("startup", "none", {"command": "no such command"}))
    assert "no such command" in failed["error"]


def test_a_shell_that_slows_jax_down_slows_no_side_down(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=0")
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    environment = process.thread_environment(2, JAX_PLATFORMS="cpu")
    assert "XLA_FLAGS" not in environment
    assert "JAX_ENABLE_X64" not in environment
    assert environment["OMP_NUM_THREADS"] == "2"


def test_peers_are_asked_with_the_settings_of_ours():
    """Every section names all its sides, each with one case per thread count or kind of call."""
    for name in SECTIONS:
        found = section(name).cases(False)
        assert found, name
        assert all(isinstance(case, Case) and case.section == name for case in found)
        json.dumps([case.settings for case in found])
    sides = {case.settings["side"] for case in learning.cases(False)}
    assert sides == {"ours-none", "ours-game", "sb3", "sbx", "rejax"}
    calls = [(case.name, case.settings["rows"]) for case in filter_section.cases(False)]
    assert {name for name, _ in calls} == set(filter_section.SIDES)
    assert {rows for _, rows in calls} == {2, 8}


def test_worlds_start_again_where_they_began():
    figures = section("simulation").run({"shield": "game", "seconds": 0.01, "worlds": 8, "periods": 3})
    assert figures["throughput"]["value"] > 0.0
    assert figures["latency"]["worst"] >= figures["latency"]["p50"]


def test_growth_is_measured_per_size_with_memory():
    figures = scaling.run(
        {"curve": "rows", "side": "ours", "sizes": [1, 2], "seconds": 0.01, "most_seconds": 60.0}
    )
    assert [point["size"] for point in figures["points"]] == [1, 2]
    assert all(point["peak_memory_mib"] > 0.0 for point in figures["points"])
    assert figures["complete"]


def test_a_curve_that_runs_out_of_time_says_that_it_is_not_complete():
    figures = scaling.run(
        {"curve": "rows", "side": "ours", "sizes": [1, 2, 4], "seconds": 0.01, "most_seconds": 0.0}
    )
    assert [point["size"] for point in figures["points"]] == [1]
    assert not figures["complete"]


def test_without_an_accelerator_its_section_says_so_in_one_line():
    assert "cpu" in section("gpu").run({"kind": "filter"})["missing"]
    figures = section("gpu").run(
        {"kind": "filter", "rows": 2, "size": 16, "seconds": 0.01, "even_without": True}
    )
    assert figures["throughput"]["unit"] == "problems/s"
    assert section("gpu").summary([{"missing": "no accelerator"}]) == {"nothing_measured": "no accelerator"}


def measured(name, cases):
    return {
        "what": SECTIONS[name], "quick": False, "when": "2026-01-01T00:00:00Z", "seconds": 1.0,
        "load_before": 0.0, "machine": {"processor": "one", "cores": 2}, "versions": {"jax": "1"},
        "cases": cases, "summary": section(name).summary(cases),
    }  # fmt: skip


def case(name, settings, **figures):
    spread = {"unit": "us", "p50": 10.0, "p99": 30.0, "worst": 90.0, "mean": 12.0, "count": 5}
    return {
        "name": name, "threads": 1, "settings": settings, "latency": spread, "peak_memory_mib": 300.0,
        "throughput": {"value": 1000.0, "unit": "steps/s"}, "compile_seconds": 1.0, **figures,
    }  # fmt: skip


def test_tables_and_figures_come_from_the_file_alone(tmp_path, capsys):
    curve = {
        "points": [{"size": n, "seconds": 1e-4 * n, "peak_memory_mib": 300.0 + n} for n in (1, 4, 16)],
        "exponent": 1.0, "complete": True,
    }  # fmt: skip
    results = {
        "sections": {
            "learning": measured(
                "learning", [case("ours, no shield", {}), case("rejax TD3", {}), {"name": "SBX TD3",
                "threads": 1,
                 "settings": {}, "missing": "sbx needs sbx"}],
            ),
            "filter": measured(
                "filter", [case(name, {"rows": 2, "calls": call}) for name in ("ours", "qpax") for call in
                ("single", "batch")],
            ),
            "joint": measured("joint", [case("joint shield", {})]),
            "scaling": measured("scaling", [case("worlds", {"curve": "worlds"}, **curve)]),
        }
    }  # fmt: skip
    report.save_section(tmp_path / "bench.json", results)
    words = ["--json", str(tmp_path / "bench.json"), "--figures", str(tmp_path / "f"), "--draw-only"]
    assert bench.main(words) == 0
    names = {path.name for path in (tmp_path / "f").iterdir()}
    assert names == {
        "bench_speed.png",
        "bench_filter.png",
        "bench_scaling.png",
        "bench_memory.png",
        "bench.md",
    }
    text = (tmp_path / "f" / "bench.md").read_text()
    assert "sbx needs sbx" in text
    assert "| rejax TD3 | 1 | 1,000 steps | 10 us | 30 us | 90 us | 1.0 | 300 |" in text
    assert draw_all({"sections": {}}, tmp_path) == []


def test_a_section_run_alone_leaves_the_others_in_the_file(tmp_path, capsys, monkeypatch):
    path = tmp_path / "bench.json"
    report.save_section(path, {"sections": {"joint": measured("joint", [case("joint shield", {})])}})
    asked, advice = [], "it needs: pip install '.[bench]'"

    def answer(case):
        asked.append(case)
        return {"name": case.name, "threads": 1, "settings": case.settings, "missing": advice}

    monkeypatch.setattr(report, "run_case", answer)
    assert bench.main(["gpu", "--json", str(path), "--quick"]) == 0
    kept = json.loads(path.read_text())["sections"]
    assert set(kept) == {"joint", "gpu"}
    assert kept["gpu"]["summary"] == {"nothing_measured": advice}
    assert advice in capsys.readouterr().out
    assert kept["gpu"]["machine"]["cores"] >= 1
    assert {"jax", "sidestep", "python"} <= set(kept["gpu"]["versions"])
    assert len(asked) == 1


def test_bad_input_is_refused_before_anything_is_measured(tmp_path, capsys):
    assert bench.main(["flter"]) == 2
    assert "no section 'flter'" in capsys.readouterr().err
    other = tmp_path / "other.json"
    other.write_text("[1]")
    assert bench.main(["gpu", "--json", str(other)]) == 2
    assert other.read_text() == "[1]"
    assert bench.main(["--draw-only"]) == 2


@pytest.mark.parametrize("option", ["--json", "--figures"])
def test_an_output_that_cannot_be_written_is_refused_before_anything_is_measured(option, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    assert bench.main(["filter", option, str(tmp_path / "file" / "below")]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("bench.py: ")
    assert "could not be written" in captured.err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_script_runs_from_any_folder(tmp_path):
    words = [sys.executable, str(BENCHMARKS / "bench.py"), "--help"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert all(name in done.stdout for name in SECTIONS)


def test_importing_the_benchmark_imports_no_peer():
    code = """
import importlib, sys
from speed.sections import SECTIONS
for name in [*SECTIONS, "filter_peers", "rejax_task"]:
    importlib.import_module(f"speed.{name}")
peers = ("torch", "stable_baselines3", "sbx", "rejax", "qpax", "cbfpy", "osqp", "clarabel")
print([name for name in peers if name in sys.modules])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=BENCHMARKS, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]", done.stdout
    assert children.MOST_SECONDS <= 300
