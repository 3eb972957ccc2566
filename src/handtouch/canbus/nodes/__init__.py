"""The nodes of a hand as their master sees them: booted, watched, brought back."""
