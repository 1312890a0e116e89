"""The traffic management centre, and what all parties agree on."""
