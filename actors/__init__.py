"""One process, one UAV: it senses, decides, moves, and ships a flight record every T_u."""
