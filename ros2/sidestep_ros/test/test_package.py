"""The package around the nodes: what is installed must be there, and the shipped parameters must be right."""

import ast
import re
from pathlib import Path

import pytest
import yaml
from sidestep_ros.parameters import DECIDING, POLICY, SCENARIO, SHIELD, TOPICS, TWIN

import sidestep

ROOT = Path(__file__).parents[1]
NODES = {
    "shield": (*SCENARIO, *TOPICS, *DECIDING, *SHIELD),
    "policy": (*SCENARIO, *TOPICS, *DECIDING, *POLICY),
    "twin": (*SCENARIO, *TOPICS, *TWIN),
}


def flat(tree, prefix=""):
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


@pytest.mark.parametrize("node", NODES)
def test_shipped_parameters_exist_and_have_the_right_type(node):
    content = yaml.safe_load((ROOT / "config" / f"{node}.yaml").read_text())
    given = dict(flat(content[f"sidestep_{node}"]["ros__parameters"]))
    known = {parameter.name: parameter for parameter in NODES[node]}
    assert given.keys() <= known.keys()
    for name, value in given.items():
        assert type(value) is type(known[name].default), name
        assert known[name].problem(value) is None


def test_versions_agree():
    in_xml = re.search(r"<version>(.+)</version>", (ROOT / "package.xml").read_text()).group(1)
    in_setup = re.search(r'version="(.+)"', (ROOT / "setup.py").read_text()).group(1)
    assert in_xml == in_setup == sidestep.__version__


def test_everything_that_is_installed_is_there():
    named = re.findall(r'"((?:config|launch)/[\w.]+)"', (ROOT / "setup.py").read_text())
    assert {(ROOT / name).name for name in named} == {
        path.name for folder in ("config", "launch") for path in (ROOT / folder).iterdir() if path.is_file()
    }
    for node in NODES:
        assert (ROOT / "sidestep_ros" / f"{node}_node.py").is_file()
    assert (ROOT / "resource" / "sidestep_ros").is_file()


def test_launch_file_starts_what_exists():
    tree = ast.parse((ROOT / "launch" / "sidestep.launch.py").read_text())
    texts = {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert {"twin_node", "twin.yaml", "sidestep.rviz", "' + '_node'", "' + '.yaml'"} <= texts
    assert any(
        isinstance(node, ast.FunctionDef) and node.name == "generate_launch_description" for node in tree.body
    )
