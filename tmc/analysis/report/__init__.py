"""What is drawn and written of a run: the summary's text, and its pictures."""
