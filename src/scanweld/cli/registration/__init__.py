"""What `scanweld register` is made of: options, the alignment and its time, the report."""
