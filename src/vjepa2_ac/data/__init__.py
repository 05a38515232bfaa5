"""Which clips, and in which order?"""
