"""VLA-World: it says what is there, predicts half a second, imagines a picture of it, thinks, and acts."""
