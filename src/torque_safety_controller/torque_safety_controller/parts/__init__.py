# SPDX-License-Identifier: Apache-2.0
"""The parts that a controller is made of; `node/assembly.py` has their order and its reasons."""
