# SPDX-License-Identifier: Apache-2.0
"""What every ROS node of the project shares: parameters, topics, messages, running."""
