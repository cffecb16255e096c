"""One run's life: simulate, record, replay, report."""
