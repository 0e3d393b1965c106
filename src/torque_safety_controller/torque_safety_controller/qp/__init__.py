"""The inverse-dynamics quadratic program and the solvers for it."""
