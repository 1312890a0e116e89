"""What a run says: metrics, report and figures, all rebuilt from its log. Only `figures` needs matplotlib."""
