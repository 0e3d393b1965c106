# SPDX-License-Identifier: Apache-2.0
"""Shared by command line tools: errors and interrupts in one line, exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import NoReturn

from viability_bounds_pkg.exceptions import ArmSafetyError

INTERRUPTED = 130
"""Exit code of a program ended by SIGINT, as shells report it."""


class Parser(argparse.ArgumentParser):
    """Reports a usage error in one line."""

    def error(self, message: str) -> NoReturn:
        """Print what is wrong, and exit with 2."""
        self.exit(2, f"{self.prog}: error: {message}\n")


def positive(text: str) -> float:
    """Return an argument that must be a finite number above 0."""
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be positive, is {text}")
    return value


def run_tool(name: str, tool: Callable[[], int]) -> int:
    """Run a tool; return its exit code: its own, 1 for an error, 130 for an interrupt.

    Args:
        name: of the tool.
        tool: returns its exit code.
    """
    try:
        return tool()
    except (ArmSafetyError, OSError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{name}: interrupted, nothing written", file=sys.stderr)
        return INTERRUPTED
