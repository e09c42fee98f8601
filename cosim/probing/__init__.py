"""What a binary is, by trying: its structure, the places where effects act, and its behaviour."""
