# SPDX-License-Identifier: Apache-2.0
"""The inverse-dynamics quadratic program, its constraints, and the solvers for it."""

from torque_safety_controller.qp.inverse_dynamics_qp import InverseDynamicsQP, Solution
from torque_safety_controller.qp.program import (
    AccelerationRange,
    ContactForces,
    LinearConstraints,
    NoSolutionFound,
    QuadraticProgram,
    TaskTerm,
    WrenchTerm,
)
from torque_safety_controller.qp.solvers import (
    SOLVERS,
    DaqpSolver,
    ProxqpSolver,
    Solver,
    SolverResult,
    Status,
)

__all__ = [
    "SOLVERS",
    "AccelerationRange",
    "ContactForces",
    "DaqpSolver",
    "InverseDynamicsQP",
    "LinearConstraints",
    "NoSolutionFound",
    "ProxqpSolver",
    "QuadraticProgram",
    "Solution",
    "Solver",
    "SolverResult",
    "Status",
    "TaskTerm",
    "WrenchTerm",
]
