"""What a reconstruction returns, its files and its metrics."""
