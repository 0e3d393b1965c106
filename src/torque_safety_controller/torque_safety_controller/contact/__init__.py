# SPDX-License-Identifier: Apache-2.0
"""Contact forces: wrist sensor, contacts of the QP, admittance and dual compliance."""
