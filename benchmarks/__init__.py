"""What the laboratory costs: `make bench`."""
