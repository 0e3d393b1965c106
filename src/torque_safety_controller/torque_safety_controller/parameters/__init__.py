"""The controller node's parameters, checked and made into settings."""
