"""What is shipped: source distribution, wheel, and an installation far from the checkout."""
