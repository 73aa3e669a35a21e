"""A drive in robot simulators: its joint document, the files of simulators, and the run-time beside them."""
