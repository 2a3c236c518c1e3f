"""Jobs as functions: files in, a directory of results out."""
