"""Planning: solvers that know no model, and the energy of actions in a world model."""
