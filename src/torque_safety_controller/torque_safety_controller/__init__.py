"""Torque control inside joint, acceleration and torque limits, solved as a QP."""

import viability_bounds_pkg
from viability_bounds_pkg.compiled_cache import keep_compiled

NOTHING_COMPILED = keep_compiled(viability_bounds_pkg.__path__[0], __path__[0])
"""Whether this is the first start since the sources changed, which takes a minute."""
