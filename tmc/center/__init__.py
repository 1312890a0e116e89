"""The TMC's process: the station, what it holds, its journal, and the service around it."""
