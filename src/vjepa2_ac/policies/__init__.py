"""Policies: an action prior for searches, scores of policies, and a monitor that detects anomalies."""
