"""What the scanner did that is not the object, as parameters that are fitted beside it."""
