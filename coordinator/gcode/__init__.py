"""G-code programs: reading them, acting on their lines, and what they tell whoever drives them."""
