"""The cache of fetched data: what was read from far away, and is kept on this disk?"""
