"""Exact joint acceleration bounds that keep position and velocity limits for ever."""

from viability_bounds_pkg.compiled_cache import keep_compiled

keep_compiled(__path__[0])
