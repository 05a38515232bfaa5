"""The index of a data set: what is known of every episode, and where is that cached?"""
