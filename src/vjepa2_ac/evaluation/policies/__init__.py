"""Judged by a world model: which policy is better, and when reality departs from what was predicted."""
