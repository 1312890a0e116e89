"""The bytes of MCAP files: parsing, repair, and rewriting."""
