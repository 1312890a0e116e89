"""What runs a mission: its processes, the supervisor that looks after them, and lock step."""
