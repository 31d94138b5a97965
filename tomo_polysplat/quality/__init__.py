"""What a result is good for, told without a truth: its resolution, and how much of a faint contrast it keeps."""
