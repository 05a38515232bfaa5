"""Export: how does a trained run leave the project? Merged, official, or as an adapter for the Hub."""
