"""A torque-controlled robot played by PyBullet over ROS 2 topics."""
