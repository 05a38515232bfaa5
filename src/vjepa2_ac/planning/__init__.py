"""Which action next? Planners (which know no model), and the energy of actions in a world model."""
