"""The Action Score: how near do plans come to what was demonstrated?"""
