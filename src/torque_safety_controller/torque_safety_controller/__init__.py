"""Torque control inside joint, acceleration and torque limits, solved as a QP."""

import viability_bounds_pkg
from viability_bounds_pkg.compiled_cache import keep_compiled

keep_compiled(viability_bounds_pkg.__path__[0], __path__[0])
