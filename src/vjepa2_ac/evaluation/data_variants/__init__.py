"""Data variants: does the model predict the data better if it is read in another way?"""
