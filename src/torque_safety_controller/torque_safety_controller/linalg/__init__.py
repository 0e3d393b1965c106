# SPDX-License-Identifier: Apache-2.0
"""Small dense linear algebra for the control step."""
