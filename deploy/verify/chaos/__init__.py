"""`overfly verify chaos`: missions that are disturbed on purpose, and what is held against their logs."""
