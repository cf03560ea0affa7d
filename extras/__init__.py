"""What the papers model beside the robot: plug-ins that `models.plug_ins` finds; nothing else imports them."""
