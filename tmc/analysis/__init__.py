"""What a finished run says: metrics, figures and the report, all rebuilt from the log."""
