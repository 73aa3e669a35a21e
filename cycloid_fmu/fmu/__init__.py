"""The FMU: the model behind every slave, the slave and the builder."""
