"""Writing RLDS: a data set in DROID's schema, field for field."""
