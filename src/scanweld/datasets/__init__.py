"""RGB-D sequences: one module per recorded format, one table of them, and a renderer with exact truth."""
