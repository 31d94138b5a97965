"""Hard cases: one kind of difficulty a file, each with a tuple of cases in the order of the table."""
