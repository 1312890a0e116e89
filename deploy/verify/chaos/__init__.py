"""`overfly verify chaos`: missions under injected faults, and the checkers of their logs."""
