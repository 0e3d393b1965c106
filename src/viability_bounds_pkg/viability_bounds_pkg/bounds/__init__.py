# SPDX-License-Identifier: Apache-2.0
"""Inside the exact bounds: loop over joints, condition (11), margins for held torque."""
