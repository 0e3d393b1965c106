"""Exact joint acceleration bounds that keep position and velocity limits for ever."""
