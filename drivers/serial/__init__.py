"""Serial ports: one thread per port, requests and answers."""
