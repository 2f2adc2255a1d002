"""Parameters: a robot must not start with a setting that was misspelt, mistyped or out of range."""

import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter as Given
from sidestep_ros.parameters import (
    DECIDING,
    GROUPS,
    POLICY,
    SCENARIO,
    TOPICS,
    ConfigurationError,
    declare,
)
from sidestep_ros.settings import check_topics, make_scenario

ALL = (*SCENARIO, *TOPICS, *DECIDING, *POLICY)


@pytest.fixture
def declared(middleware):
    nodes = []

    def make(**given):
        overrides = [Given(name.replace("__", "."), value=value) for name, value in given.items()]
        nodes.append(Node("parameters", parameter_overrides=overrides))
        return declare(nodes[-1], ALL)

    yield make
    for node in nodes:
        node.destroy_node()


def test_defaults_are_usable(declared):
    values = declared()
    check_topics(values)
    assert make_scenario(values).pursuer_count == 1


def test_everything_wrong_is_said_at_once(declared):
    with pytest.raises(ConfigurationError) as caught:
        declared(scenaro="paper", grace=7.0, late_after=1, shield="jiont", target=[float("nan"), 0.0])
    problems = "\n".join(caught.value.problems)
    assert len(caught.value.problems) == 5
    assert "no parameter 'scenaro'; did you mean 'scenario'?" in problems
    assert "'grace' is 7.0, but must be between 0.0 and 1.0" in problems
    assert "'late_after' is 1, but must be a decimal number" in problems
    assert "did you mean 'joint'?" in problems
    assert "must be finite" in problems


def test_parameter_of_another_node_is_left_in_peace(declared):
    assert declared(physics="plain")["shield"] == "joint"


def test_only_what_may_change_is_not_read_only():
    live = {parameter.name for group in GROUPS for parameter in group if parameter.live}
    assert live == {"target"}
    for group in GROUPS:
        for parameter in group:
            descriptor = parameter.descriptor()
            assert descriptor.read_only != parameter.live
            assert descriptor.description


def test_scenario_has_a_robot_for_every_topic(declared):
    scenario = make_scenario(
        declared(
            pursuers__topics=["a", "b"], obstacles__topics=[""], scenario_overrides=["evader_speed=0.15"]
        )
    )
    assert (scenario.pursuer_count, scenario.obstacle_count) == (2, 0)
    assert float(scenario.evader_speed) == pytest.approx(0.15)


def test_scenario_that_cannot_be_run_is_a_problem_of_the_parameters(declared):
    with pytest.raises(ConfigurationError, match="evader_speed"):
        make_scenario(declared(scenario_overrides=["evader_speed=-1"]))
    with pytest.raises(ConfigurationError, match="NAME=VALUE"):
        make_scenario(declared(scenario_overrides=["evader_speed"]))


def test_two_robots_on_one_topic_are_refused(declared):
    with pytest.raises(ConfigurationError, match="'evader/pose' is given for more than one robot"):
        check_topics(declared(pursuers__topics=["evader/pose"]))


def test_node_needs_a_pursuer(declared):
    with pytest.raises(ConfigurationError, match="at least one pursuer"):
        check_topics(declared(pursuers__topics=[""]))


def test_middleware_is_the_one_tested_with(middleware):
    assert rclpy.utilities.get_rmw_implementation_identifier() == "rmw_fastrtps_cpp"
