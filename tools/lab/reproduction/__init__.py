"""The paper reproduced: experiments that are kept, claims that rest on them, and one page of
both.
"""
