# SPDX-License-Identifier: Apache-2.0
"""Build description of viability_bounds_pkg."""

from setuptools import find_packages, setup

PACKAGE = "viability_bounds_pkg"

setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={PACKAGE: ["py.typed", "ros/*_names.txt", "ros/fastdds.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml", f"{PACKAGE}/ros/fastdds.xml"]),
    ],
    python_requires=">=3.10",
    install_requires=[
        "array-api-compat>=1.10",
        "daqp>=0.7",
        "numba>=0.59",
        "numpy>=1.26",
        "pin>=3",
        "PyYAML>=6",
        "scipy>=1.11",
    ],
    extras_require={"test": ["pytest", "hypothesis"]},
    zip_safe=True,
    author="The viability bounds authors",
    author_email="maintainers@viability-bounds.example.org",
    maintainer="The viability bounds authors",
    maintainer_email="maintainers@viability-bounds.example.org",
    description="Exact joint acceleration bounds from position, velocity and "
    "acceleration limits (Del Prete, RA-L 2018), as a library and a ROS 2 node.",
    license="Apache-2.0",
    license_files=["LICENSE"],
    entry_points={
        "console_scripts": [
            "bounds_node = viability_bounds_pkg.cli.ros_program:bounds_node",
            "estimator_node = viability_bounds_pkg.cli.ros_program:estimator_node",
            "estimate_acceleration_limits = "
            "viability_bounds_pkg.cli.ros_program:estimate_acceleration_limits",
        ],
    },
)
