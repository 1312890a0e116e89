"""What verifies a mission: exactness, asynchrony, and chaos."""
