# SPDX-License-Identifier: Apache-2.0
"""The inverse-dynamics quadratic program, its constraints, and the solvers for it."""

from torque_safety_controller.qp.constraints import (
    AccelerationRange,
    Constraint,
    LinearConstraints,
)
from torque_safety_controller.qp.daqp_solver import DaqpSolver
from torque_safety_controller.qp.inverse_dynamics_qp import (
    ContactForces,
    InverseDynamicsQP,
    Solution,
)
from torque_safety_controller.qp.proxqp_solver import ProxqpSolver
from torque_safety_controller.qp.quadratic_program import (
    NoSolutionFound,
    QuadraticProgram,
    Solver,
    SolverResult,
    Status,
)
from torque_safety_controller.qp.terms import TaskTerm, WrenchTerm

__all__ = [
    "AccelerationRange",
    "Constraint",
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
