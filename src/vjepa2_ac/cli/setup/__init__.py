"""The commands of the first hour: the demo, a config for what is there, what a run needs, and downloads."""
