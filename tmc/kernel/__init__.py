"""The agreement: pure functions and frozen values that every process shares. No sockets, files, clocks or globals."""
