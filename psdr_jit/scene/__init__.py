"""What is in a scene: parameters, files, facts about its objects, and what is refused or warned about."""
