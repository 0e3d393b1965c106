"""Joint friction: compensation and identification."""
