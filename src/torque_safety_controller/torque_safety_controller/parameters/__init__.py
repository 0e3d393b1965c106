# SPDX-License-Identifier: Apache-2.0
"""The controller node's parameters: each declared once, and checked together."""
