# SPDX-License-Identifier: Apache-2.0
"""What users write, checked before it is used: YAML, parameter files, names, robots."""

from viability_bounds_pkg.user_input.known_names import parameter_names, unknown_parameters
from viability_bounds_pkg.user_input.parameter_files import ParameterFileError, read_files
from viability_bounds_pkg.user_input.urdf_check import check_with_urdf
from viability_bounds_pkg.user_input.yaml_file import YamlError, load_yaml, read_yaml

__all__ = [
    "ParameterFileError",
    "YamlError",
    "check_with_urdf",
    "load_yaml",
    "parameter_names",
    "read_files",
    "read_yaml",
    "unknown_parameters",
]
