"""How pages look: templates, what they are filled with, and the files that browsers load with them."""
