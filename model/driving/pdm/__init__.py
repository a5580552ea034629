"""NAVSIM's planning scores, PDMS v1.1 and EPDMS v2.2, for many plans of one moment at once."""
