"""Planning: model-independent solvers, and the energy of action sequences in a world model."""
