"""Serial ports: one thread for each, questions and answers."""
