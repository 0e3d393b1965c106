"""Forces at the hand and other contacts."""
