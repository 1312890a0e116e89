"""Compute, check and draw a run, all from its logs. Only the modules of `report` that draw need matplotlib."""
