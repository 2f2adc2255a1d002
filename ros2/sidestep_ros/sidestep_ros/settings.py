"""Scenario, settings of the decision core and plant from the parameters."""

import json
from typing import Any

from sidestep_ros.parameters import ConfigurationError

_OF_ONBOARD = (
    "position_noise", "heading_noise", "actuation_delay", "motor_lag", "motor_acceleration",
    "predict_pursuer", "obstacle_acceleration", "stale_after", "nominal_timeout", "on_fault",
    "jump_tolerance", "heading_tolerance", "jump_confirmations", "future_tolerance",
)  # fmt: skip
"""Parameters with the names of fields of `OnboardSettings`."""


def make_scenario(values: dict[str, Any]) -> Any:
    """The scenario of the parameters, with one pursuer or obstacle per topic.

    **Raises** `ConfigurationError` for an invalid scenario.
    """
    from sidestep.world import ScenarioError, load_scenario

    fields: dict[str, Any] = {
        "pursuer_count": len(values["pursuers.topics"]),
        "obstacle_count": len(values["obstacles.topics"]),
    }
    problems = []
    for pair in values["scenario_overrides"]:
        name, equals, text = pair.partition("=")
        if not equals or not name:
            problems.append(f"'scenario_overrides' has '{pair}', which is not of the form NAME=VALUE")
            continue
        try:
            fields[name] = json.loads(text)
        except json.JSONDecodeError:
            fields[name] = text
    if problems:
        raise ConfigurationError(problems)
    try:
        return load_scenario(values["scenario"], **fields)
    except (ScenarioError, OSError) as error:
        raise ConfigurationError([str(error)]) from error


def make_plant(values: dict[str, Any], scenario: Any) -> Any:
    """The twin's `sidestep.plants.Plant`: the simulation, or bodies in MuJoCo.

    **Raises** `ConfigurationError` for unknown sensors or an unknown base, and without MuJoCo.
    """
    if values["physics"] == "plain":
        from sidestep.plants import Simulation

        return Simulation(scenario, values["evader_heading"])
    from sidestep.plants.ground import Twin, TwinError, TwinOptions, make_sensors

    try:
        options = TwinOptions(base=values["base"], sensors=make_sensors(values["sensors"]))
        return Twin(scenario, options, values["seed"])
    except TwinError as error:
        raise ConfigurationError([str(error)]) from error


def make_onboard_settings(values: dict[str, Any], scenario: Any) -> Any:
    """`OnboardSettings` from the parameters. **Raises** `ConfigurationError` for invalid ones."""
    from sidestep.robot import OnboardSettings
    from sidestep.safety import Budget

    budget = {
        name.removeprefix("budget."): value for name, value in values.items() if name.startswith("budget.")
    }
    try:
        settings = OnboardSettings(budget=Budget(**budget), **{name: values[name] for name in _OF_ONBOARD})
        settings.budget.check(scenario)
    except ValueError as error:
        raise ConfigurationError([str(error)]) from error
    return settings


def check_topics(values: dict[str, Any]) -> None:
    """**Raises** `ConfigurationError` unless every robot has a separate topic."""
    topics = [values["evader.topic"], *values["pursuers.topics"], *values["obstacles.topics"]]
    problems = [f"topic '{topic}' is given for more than one robot" for topic in _repeated(topics)]
    if not values["evader.topic"]:
        problems.append("'evader.topic' is empty: without the evader's pose nothing can be decided")
    if not values["pursuers.topics"]:
        problems.append("'pursuers.topics' is empty: give the topic of at least one pursuer")
    if problems:
        raise ConfigurationError(problems)


def _repeated(topics: list[str]) -> list[str]:
    return sorted({topic for topic in topics if topic and topics.count(topic) > 1})
