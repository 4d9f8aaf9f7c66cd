-- The code behind the tables: how canductor's decoder reads a bus, once more in Lua for Wireshark.
--
-- Wireshark shows the frames of a capture in any order and again and again, but the first time it asks for
-- each of them in order. What a frame says depends on those before it, so all is worked out that first time
-- and kept by the number of the frame; later only what was kept is shown.
--
-- `tshark -2` asks the first time without fields (nobody wants to see any), so that the interface of a frame
-- is not known: then all is worked out again the second time, which is in order too.

local bxor, band, rshift = bit.bxor, bit.band, bit.rshift
local TO, FROM = "to", "from"
local GAP_S, NOISE_SHOWN, REPEAT_S = D.gap_s, D.noise_shown, D.repeat_s
local BLOCK_MIN, BLOCK_MAX = D.block.length_min, D.block.length_max

local canductor = Proto("canductor", "Klipper's protocol over CAN")

-- ------------------------------------------------------------------------------------------------- fields

local f = {
  kind = ProtoField.string("canductor.kind", "Kind"),
  message = ProtoField.string("canductor.message", "Message"),
  text = ProtoField.string("canductor.text", "Text"),
  direction = ProtoField.string("canductor.direction", "Direction"),
  nodeid = ProtoField.uint8("canductor.nodeid", "Node id"),
  seq = ProtoField.uint8("canductor.seq", "Sequence"),
  repeated = ProtoField.bool("canductor.repeated", "Repeated"),
  extension = ProtoField.bool("canductor.extension", "Extension of canductor's firmware"),
  meaning = ProtoField.string("canductor.meaning", "Meaning"),
  payload = ProtoField.bytes("canductor.payload", "Part of the byte stream"),
  length = ProtoField.uint8("canductor.block.length", "Length"),
  content = ProtoField.bytes("canductor.block.content", "Content"),
  crc = ProtoField.uint16("canductor.block.crc", "Checksum", base.HEX),
  begins_in = ProtoField.framenum("canductor.block.begins_in", "Block begins in frame"),
  ends_in = ProtoField.framenum("canductor.block.ends_in", "Block ends in frame"),
}
for name, field in pairs(D.fields) do
  if not f[name] then
    local make = field.kind == "uuid" and ProtoField.string or ProtoField["uint" .. field.size * 8]
    if field.kind == "uuid" then
      f[name] = make("canductor." .. name, field.label)
    else
      f[name] = make("canductor." .. name, field.label, field.kind == "hex" and base.HEX or base.DEC, field.values)
    end
  end
end
local numbers, buffers = {}, {}
for _, name in ipairs(D.number_params) do
  numbers[name] = ProtoField.int64("canductor.param." .. name, name)
end
for _, name in ipairs(D.buffer_params) do
  local clash = numbers[name] and "_data" or ""
  buffers[name] = ProtoField.bytes("canductor.param." .. name .. clash, name)
end
local all = {}
for _, set in ipairs({ f, numbers, buffers }) do
  for _, field in pairs(set) do
    all[#all + 1] = field
  end
end
canductor.fields = all

local noise_expert = ProtoExpert.new("canductor.noise", "Bytes that make no block", expert.group.MALFORMED, expert.severity.WARN)
local nak_expert = ProtoExpert.new("canductor.nak", "The node refuses a block", expert.group.SEQUENCE, expert.severity.NOTE)
local repeated_expert =
  ProtoExpert.new("canductor.again", "Block sent again", expert.group.SEQUENCE, expert.severity.NOTE)
local unknown_expert =
  ProtoExpert.new("canductor.unknown", "Not in the dictionary", expert.group.UNDECODED, expert.severity.NOTE)
canductor.experts = { noise_expert, nak_expert, repeated_expert, unknown_expert }

local can_id_of = Field.new("can.id")
local interface_of = Field.new("frame.interface_id")
