"""VNN-LIB queries: read, answered by a witness, evaluated exactly."""
