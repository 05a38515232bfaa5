"""How do the weights change?"""
