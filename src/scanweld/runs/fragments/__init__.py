"""A long recording in fragments: each is tracked and fused by itself; then they are tied together and made one."""
