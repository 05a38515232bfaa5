"""Data variants: does the model predict the data better when it is read another way?"""
