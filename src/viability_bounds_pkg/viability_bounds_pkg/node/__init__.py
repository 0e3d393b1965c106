# SPDX-License-Identifier: Apache-2.0
"""The bounds node and the estimator node, and their parameters."""
