"""Questions about a controller alone, as VNN-LIB specifications."""
