"""What a scene needs: questions to the data, the order in which they are asked, and their answers."""
