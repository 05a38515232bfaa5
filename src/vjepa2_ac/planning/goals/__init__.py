"""Goals: images to reach one after another, when each takes its turn, and how they are found and stored."""
