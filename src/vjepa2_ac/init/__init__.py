"""A config for what is there: the data are looked at, the machine too, and each value has its reason beside it."""
