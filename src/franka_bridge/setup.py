# SPDX-License-Identifier: Apache-2.0
"""Build description of franka_bridge."""

from setuptools import find_packages, setup

PACKAGE = "franka_bridge"

setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={PACKAGE: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=["setuptools", "numpy", "viability_bounds_pkg"],
    extras_require={"franka": ["pylibfranka"], "test": ["pytest", "franky-sim"]},
    zip_safe=True,
    author="The viability bounds authors",
    author_email="maintainers@viability-bounds.example.org",
    maintainer="The viability bounds authors",
    maintainer_email="maintainers@viability-bounds.example.org",
    description="A Franka arm as the robot of this project's nodes, by libfranka.",
    license="Apache-2.0",
    license_files=["LICENSE"],
    entry_points={
        "console_scripts": [
            "franka_node = franka_bridge.programs:franka_node",
            "franka_stack = franka_bridge.programs:franka_stack",
            "simulated_fr3 = franka_bridge.programs:simulated_fr3",
        ],
    },
)
