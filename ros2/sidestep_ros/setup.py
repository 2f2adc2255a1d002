"""Installs the package the way ament expects it."""

from setuptools import setup

NAME = "sidestep_ros"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/sidestep.launch.py"]),
        (
            f"share/{NAME}/config",
            ["config/shield.yaml", "config/policy.yaml", "config/twin.yaml", "config/sidestep.rviz"],
        ),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Keeps a robot that is being pursued safe: filters its cmd_vel, or drives it to a target.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"{node} = sidestep_ros.{node}:main" for node in ("shield_node", "policy_node", "twin_node")
        ],
    },
)
