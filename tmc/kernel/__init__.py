"""The agreement: pure functions and frozen values that all processes share. No sockets, clocks or globals."""
