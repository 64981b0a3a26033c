"""What is checked before the first motion; judged here, read and moved elsewhere."""
