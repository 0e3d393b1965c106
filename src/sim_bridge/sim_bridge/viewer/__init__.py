# SPDX-License-Identifier: Apache-2.0
"""The page in the browser: shapes of the arm, pictures of its joints, and forces. No ROS here."""
