"""Where do episodes come from?"""
