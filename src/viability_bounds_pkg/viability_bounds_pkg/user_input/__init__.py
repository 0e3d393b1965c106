# SPDX-License-Identifier: Apache-2.0
"""What users write, checked before it is used: YAML, parameter files, names, robots."""

from viability_bounds_pkg.user_input.known_names import (
    graph_names,
    parameter_names,
    unknown_parameters,
)
from viability_bounds_pkg.user_input.parameter_files import (
    ParameterFileError,
    check_parameter_files,
)
from viability_bounds_pkg.user_input.urdf_check import check_with_urdf
from viability_bounds_pkg.user_input.yaml_file import YamlError, load_yaml, read_yaml

__all__ = [
    "ParameterFileError",
    "YamlError",
    "check_parameter_files",
    "check_with_urdf",
    "graph_names",
    "load_yaml",
    "parameter_names",
    "read_yaml",
    "unknown_parameters",
]
