# SPDX-License-Identifier: Apache-2.0
"""Which robot it is: its parameters, its URDF and the model made of them."""
