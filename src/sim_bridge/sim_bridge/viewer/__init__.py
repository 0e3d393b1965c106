# SPDX-License-Identifier: Apache-2.0
"""The arm in a browser: its shapes, the pictures of its joints, and the page that has both.

Nothing here knows ROS but the room `node`, which gives the page what comes on the topics.
"""
