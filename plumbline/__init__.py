"""The face of the laboratory: the command line, and the names a notebook imports."""
