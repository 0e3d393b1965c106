# SPDX-License-Identifier: Apache-2.0
"""Robot descriptions rewritten for PyBullet."""
