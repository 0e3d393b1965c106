"""Small dense linear algebra for the control step."""
