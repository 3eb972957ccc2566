"""Programs that measure handtouch, and the pages of what they found."""
