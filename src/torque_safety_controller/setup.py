# SPDX-License-Identifier: Apache-2.0
"""Build description of torque_safety_controller."""

from setuptools import find_packages, setup

PACKAGE = "torque_safety_controller"

setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={PACKAGE: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    python_requires=">=3.10",
    install_requires=[
        "daqp>=0.7",
        "numba>=0.59",
        "numpy>=1.26",
        "pin>=3",
        "proxsuite>=0.6",
        "PyYAML>=6",
        "scipy>=1.11",
        "tqdm>=4",
        "viability_bounds_pkg",
    ],
    extras_require={"test": ["pytest", "hypothesis"]},
    zip_safe=True,
    author="The viability bounds authors",
    author_email="maintainers@viability-bounds.example.org",
    maintainer="The viability bounds authors",
    maintainer_email="maintainers@viability-bounds.example.org",
    description="Inverse-dynamics QP torque control that stays inside acceleration "
    "bounds and torque limits (Benallegue et al., IROS 2021).",
    license="Apache-2.0",
    license_files=["LICENSE"],
    entry_points={
        "console_scripts": [
            "controller_node = torque_safety_controller.cli.ros_program:controller_node",
            "fit_capsules = torque_safety_controller.cli.ros_program:fit_capsules",
            "gain_limits = torque_safety_controller.cli.ros_program:gain_limits",
            "identify_friction = torque_safety_controller.cli.ros_program:identify_friction",
            "moveit_node = torque_safety_controller.cli.ros_program:moveit_node",
            "new_robot = torque_safety_controller.cli.ros_program:new_robot",
            "safety_stack = torque_safety_controller.cli.ros_program:safety_stack",
            "teleop = torque_safety_controller.cli.ros_program:teleop",
        ],
        "arm_safety.stacks": [
            "safety_stack = torque_safety_controller.node.safety_stack",
        ],
    },
)
