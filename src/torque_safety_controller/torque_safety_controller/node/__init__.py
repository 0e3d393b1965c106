"""The controller node: messages in, messages out."""
