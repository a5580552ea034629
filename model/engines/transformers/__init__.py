"""The engine without shortcuts: one draw after the other, a token a pass, by `transformers` alone.

What the other engines write is compared with this. It serves too, where simple counts more than fast.
"""
