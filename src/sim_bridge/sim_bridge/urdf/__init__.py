"""Robot descriptions made ready for PyBullet."""
