"""Robots that look for a pair of parts among all contacts in one order, next to twins that take both."""

import numpy as np
import pybullet as p
from mujoco_robots import MujocoArm, MujocoHopper
from robots import Crawler, Pusher


class HopperFeet(MujocoHopper):
    """It sees which of its feet stand on the ground."""

    def pairs(self):
        return [{contact.geom1, contact.geom2} for contact in self.data.contact]

    def pair(self, sole):
        return {sole, self.model.geom("ground").id}

    def observe(self):
        pairs = self.pairs()
        feet = [float(self.pair(self.model.geom(f"{side}_sole").id) in pairs) for side in ("left", "right", "back")]
        return np.append(super().observe(), feet)


class RL830HopperFeetFirst(HopperFeet):
    rlctl_ignore = {"RL110": "a consequence"}

    def pairs(self):
        return [(contact.geom1, contact.geom2) for contact in self.data.contact]

    def pair(self, sole):
        return sole, self.model.geom("ground").id


class ArmLeans(MujocoArm):
    """It pays where its finger touches the table, on which it begins."""

    rlctl_ignore = {"RL611": "chance hardly finds its goals from there"}
    home = np.array([1.5, 1.6, 0.0])

    def touches(self, one, two):
        return {one, two} == {self.model.geom("finger").id, self.model.geom("table").id}

    def reward(self):
        leans = any(self.touches(contact.geom1, contact.geom2) for contact in self.data.contact)
        return super().reward() - 0.5 * leans


class RL830ArmLeansUnseen(ArmLeans):
    def touches(self, one, two):
        return (one, two) == (self.model.geom("finger").id, self.model.geom("table").id)


class CrawlerFeetOfAll(Crawler):
    """It looks for the contacts of its feet with the floor among all."""

    def size(self):
        return super().size() + 2

    def is_pair(self, contact, foot):
        sides = {(contact[1], contact[3]), (contact[2], contact[4])}
        return sides == {(self.robot, foot), (self.floor, -1)}

    def observe(self):
        contacts = p.getContactPoints(physicsClientId=self.client)
        feet = [float(any(self.is_pair(contact, foot) for contact in contacts)) for foot in range(2)]
        return np.append(super().observe(), feet).astype(np.float32)


class CrawlerFeetFirst(CrawlerFeetOfAll):
    """It takes the one order that PyBullet has here; nothing is wrong with it."""

    def is_pair(self, contact, foot):
        return (contact[1], contact[3], contact[2]) == (self.robot, foot, self.floor)


class RL830CrawlerFloorFirst(CrawlerFeetOfAll):
    rlctl_ignore = {**CrawlerFeetOfAll.rlctl_ignore, "RL110": "a consequence"}

    def is_pair(self, contact, foot):
        return (contact[2], contact[4], contact[1]) == (self.robot, foot, self.floor)


class PusherStands(Pusher):
    """It ends where its cube has left the floor."""

    def stands(self, contact):
        return {contact[1], contact[2]} == {self.cube, self.floor}

    def info(self, success):
        contacts = p.getContactPoints(physicsClientId=self.client)
        return {**super().info(success), "stands": any(map(self.stands, contacts))}


class RL830PusherNeverStands(PusherStands):
    def stands(self, contact):
        return contact[1:3] == (self.cube, self.floor)
