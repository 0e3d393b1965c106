# SPDX-License-Identifier: Apache-2.0
"""Build description of sim_bridge."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "sim_bridge"
FOLDERS = (
    "imperfect",
    "layouts",
    "obstacles",
    "scenarios",
    "scenarios/start",
    "two_hands",
)
CONFIG = ("config", *(f"config/{folder}" for folder in FOLDERS))


def _files(folder: str) -> list[str]:
    return glob(f"{folder}/*.*ml") + glob(f"{folder}/*.json")


setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={PACKAGE: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        *((f"share/{PACKAGE}/{folder}", _files(folder)) for folder in CONFIG),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest", "hypothesis"]},
    zip_safe=True,
    author="The viability bounds authors",
    author_email="maintainers@viability-bounds.example.org",
    maintainer="The viability bounds authors",
    maintainer_email="maintainers@viability-bounds.example.org",
    description="A torque-controlled arm simulated by PyBullet at a fixed rate, and "
    "scenarios to drive it.",
    license="Apache-2.0",
    license_files=["LICENSE"],
    entry_points={
        "console_scripts": [
            "bullet_node = sim_bridge.programs:bullet_node",
            "record_excitation = sim_bridge.programs:record_excitation",
            "viewer_node = sim_bridge.programs:viewer_node",
            "simulated_stack = sim_bridge.programs:simulated_stack",
            "scenario_node = sim_bridge.programs:scenario_node",
        ],
    },
)
