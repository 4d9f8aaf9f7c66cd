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

-- -------------------------------------------------------------------------------------------------- values

local function hex(bytes, separator)
  return (bytes:gsub(".", function(c)
    return string.format("%02x", c:byte()) .. (separator or "")
  end):gsub(" $", ""))
end

-- Reads a number at AT; returns it as unsigned 32 bits and where it ends, or nothing when it is cut short.
local function read_number(content, at)
  local group = content:byte(at)
  if not group then
    return nil
  end
  local value = group % 0x80
  if value >= 0x60 then
    value = value - 0x80
  end
  local first = at
  at = at + 1
  while group >= 0x80 do
    group = content:byte(at)
    if not group or at - first >= 5 then
      return nil
    end
    value = value * 0x80 + group % 0x80
    at = at + 1
  end
  return value % 0x100000000, at
end

local function clipped(code, value)
  local width = D.widths[code]
  value = value % 2 ^ width
  if D.signed[code] and value >= 2 ^ (width - 1) then
    value = value - 2 ^ width
  end
  return value
end

local function whole(value)
  return string.format("%d", value)
end

-- Reads parameters with CODES at AT; returns the values and where they end, or nothing.
local function read_values(codes, content, at)
  local values = {}
  for i, code in ipairs(codes) do
    local number
    number, at = read_number(content, at)
    if not number then
      return nil
    end
    if D.widths[code] then
      values[i] = clipped(code, number)
    else
      if number > #content - at + 1 then
        return nil
      end
      values[i] = content:sub(at, at + number - 1)
      at = at + number
    end
  end
  return values, at
end

local function printable(text)
  if text:find("^[\32-\126]*$") then
    return text
  end
  return "'" .. text:gsub("[^\32-\126]", function(c)
    return string.format("\\x%02x", c:byte())
  end) .. "'"
end

-- The text of debug outputs is a printf format.
local function output_text(format, values)
  local i = 0
  local text = format.text:gsub("%%(%.?%*?h?[%%suic])", function(code)
    if code == "%" then
      return "%"
    end
    i = i + 1
    return type(values[i]) == "number" and whole(values[i]) or values[i]
  end)
  return format.name .. " " .. printable(text)
end

local function message_text(dictionary, format, values)
  if format.text then
    return output_text(format, values)
  end
  local words = { format.name }
  for i, value in ipairs(values) do
    local shown
    if type(value) == "string" then
      shown = hex(value)
    else
      local names = dictionary.enumerations[format.enumerations[i]]
      shown = names and names[value] or whole(value)
    end
    words[#words + 1] = format.names[i] .. "=" .. shown
  end
  return table.concat(words, " ")
end

local function dictionary_of(nodeid)
  return D.dictionaries[nodeid] or D.dictionaries.any
end

local function format_at(formats, content, at)
  local id
  id, at = read_number(content, at)
  if not id then
    return nil
  end
  return formats[id < 0x80000000 and id or id - 0x100000000], at
end

-- ---------------------------------------------------------------------------------------- blocks out of bytes

local function checksum(bytes)
  local crc = D.block.crc_start
  for i = 1, #bytes do
    crc = bxor(crc, bytes:byte(i))
    for _ = 1, 8 do
      local odd = band(crc, 1) == 1
      crc = rshift(crc, 1)
      if odd then
        crc = bxor(crc, D.block.crc_polynomial)
      end
    end
  end
  return crc
end

local function is_sound(block)
  local crc = block:byte(-3) * 256 + block:byte(-2)
  return block:byte(-1) == D.block.sync and checksum(block:sub(1, -4)) == crc
end

-- What DATA begins with: "block" and its length, "more" is needed for one, or it is "lost".
local function scan(data)
  if data == "" then
    return "more"
  end
  local wanted = data:byte(1)
  local mark = data:byte(2)
  if wanted < BLOCK_MIN or wanted > BLOCK_MAX then
    return "lost"
  elseif mark and mark - mark % 16 ~= D.block.sequence_mark then
    return "lost"
  elseif #data < wanted then
    return "more"
  end
  if is_sound(data:sub(1, wanted)) then
    return "block", wanted
  end
  return "lost"
end

local function without_sync(data)
  return (data:gsub("^" .. string.char(D.block.sync) .. "+", ""))
end

-- Where a sound block begins behind the first byte of what may be noise; 0: nowhere.
local function sound_block_at(data)
  for at = 1, #data - BLOCK_MIN do
    local wanted = data:byte(at + 1)
    if wanted >= BLOCK_MIN and wanted <= #data - at and scan(data:sub(at + 1)) == "block" then
      return at
    end
  end
  return 0
end

local function tell_noise(stream, found)
  found[#found + 1] = { noise = stream.noise }
  stream.noise = ""
end

-- Every sound block in DATA, whatever precedes it; what may become one is held.
local function cut(stream, data, last)
  local found = {}
  while data ~= "" do
    data = without_sync(data)
    local outcome, length = scan(data)
    if outcome == "block" then
      if stream.noise ~= "" then
        tell_noise(stream, found)
      end
      found[#found + 1] = { block = data:sub(1, length) }
      data = data:sub(length + 1)
    else
      local drop = 1
      if outcome == "more" and not last then
        drop = stream.noise ~= "" and sound_block_at(data) or 0
        if drop == 0 then
          break
        end
      end
      stream.noise = stream.noise .. data:sub(1, drop)
      if #stream.noise >= NOISE_SHOWN then
        tell_noise(stream, found)
      end
      data = data:sub(drop + 1)
    end
  end
  stream.held = data
  return found
end

-- Takes a frame's payload; returns what it completed.
local function feed(stream, data, now_s)
  local found = {}
  if stream.held ~= "" and now_s - stream.held_s > GAP_S then
    found = cut(stream, stream.held, true)
    if stream.noise ~= "" then
      tell_noise(stream, found)
    end
  end
  stream.held_s = now_s
  data = stream.held .. data
  if #data > 1 and data:byte(1) ~= D.block.sync and scan(data) == "more" then
    stream.held = data -- as the decoder: what begins like a block is waited for
    return found
  end
  for _, item in ipairs(cut(stream, data, false)) do
    found[#found + 1] = item
  end
  return found
end

-- -------------------------------------------------------------------------------------------- flow control

local function new_flow()
  return { before = {}, order = {} } -- order: numbers under way
end

local function place_of(list, wanted)
  for i, value in ipairs(list) do
    if value == wanted then
      return i
    end
  end
  return nil
end

-- Whether a block to the node is a repeat.
local function sent(flow, block, seq, now_s)
  local before = flow.before[seq]
  flow.before[seq] = { block = block, time_s = now_s }
  if seq ~= flow.next and before and before.block == block then
    local age_s = now_s - before.time_s
    if age_s >= 0 and age_s <= REPEAT_S then
      return true
    end
  end
  flow.next = (seq + 1) % 16
  local flies = place_of(flow.order, seq)
  if flies then
    table.remove(flow.order, flies)
  end
  flow.order[#flow.order + 1] = seq
  return false
end

local function lose_count(flow)
  flow.next = nil
  flow.order = {}
end

-- Whether a block from the node refuses one that was sent: an empty block with the number of the one before,
-- or a first answer that names no block under way, to a host that just came and has to learn the number.
local function answered(flow, block, seq)
  local before, is_empty = flow.answered, #block == BLOCK_MIN
  flow.answered = seq
  local acknowledged = place_of(flow.order, (seq - 1) % 16)
  local flies = place_of(flow.order, seq)
  if acknowledged then
    for _ = 1, acknowledged do
      table.remove(flow.order, 1)
    end
  elseif #flow.order > 0 and not flies and seq ~= before then
    lose_count(flow)
    flow.empty = is_empty and seq or flow.empty
    return before == nil
  end
  if not is_empty then
    return false
  end
  local again = flow.empty == seq
  flow.empty = seq
  if acknowledged or not again or #flow.order == 0 then
    return false
  end
  if not flies then
    lose_count(flow)
  end
  return true
end

-- ------------------------------------------------------------------------------------------ what is said

local function commands_in(nodeid, content)
  local dictionary, said, at = dictionary_of(nodeid), {}, 1
  while at <= #content do
    local format, start = format_at(dictionary.commands, content, at)
    local values, behind
    if format then
      values, behind = read_values(format.codes, content, start)
    end
    if not values then
      said[#said + 1] = { name = "unknown", text = "unknown content=" .. hex(content:sub(at), " "), unknown = true }
      break
    end
    said[#said + 1] = { format = format, values = values, text = message_text(dictionary, format, values) }
    at = behind
  end
  return said
end

local function response_in(nodeid, content)
  local dictionary = dictionary_of(nodeid)
  local format, start = format_at(dictionary.responses, content, 1)
  local values, behind
  if format then
    values, behind = read_values(format.codes, content, start)
  end
  if not values or behind ~= #content + 1 then
    return { { name = "unknown", text = "unknown content=" .. hex(content, " "), unknown = true } }
  end
  return { { format = format, values = values, text = message_text(dictionary, format, values) } }
end

local function interpret(flow, nodeid, direction, block, now_s)
  local seq, content = block:byte(2) % 16, block:sub(D.block.content_at + 1, -4)
  local item = { block = block, seq = seq, kind = "message" }
  if direction == TO then
    item.repeated = sent(flow, block, seq, now_s)
    item.said = commands_in(nodeid, content)
    if content == "" then
      item.said = { { name = "empty_block", text = "empty_block" } }
    end
    return item
  end
  local refused = answered(flow, block, seq)
  if content == "" then
    item.kind = refused and "nak" or "ack"
    item.said = { { name = item.kind, text = item.kind .. " next=" .. seq } }
  else
    item.said = response_in(nodeid, content)
  end
  return item
end

-- ---------------------------------------------------------------------------------- state of a capture

local buses, results, ends_in

function canductor.init()
  buses, results, ends_in = {}, {}, {}
end

local function of(map, key, make)
  map[key] = map[key] or make()
  return map[key]
end

local function new_stream()
  return { held = "", held_s = 0, noise = "", frames = {} }
end

local function new_bus()
  return { streams = {}, flows = {} }
end

-- What this frame completes.
local function work_out(pinfo, bus, can_id, nodeid, direction, data)
  local stream = of(bus.streams, can_id, new_stream)
  local flow = of(bus.flows, nodeid, new_flow)
  local now_s = pinfo.rel_ts
  local items = {}
  for _, found in ipairs(feed(stream, data, now_s)) do
    if found.noise then
      local text = #found.noise .. " bytes make no block: " .. hex(found.noise, " ")
      items[#items + 1] = { kind = "noise", bytes = found.noise, said = { { name = "noise", text = text } } }
    else
      items[#items + 1] = interpret(flow, nodeid, direction, found.block, now_s)
    end
    items[#items].begins_in = stream.frames[1] or pinfo.number
    for _, number in ipairs(stream.frames) do
      ends_in[number] = ends_in[number] or pinfo.number
    end
    stream.frames = {}
  end
  if stream.held ~= "" then
    stream.frames[#stream.frames + 1] = pinfo.number
  end
  return items
end

-- ------------------------------------------------------------------------------------------------- showing

local function show_values(tree, said)
  for i, value in ipairs(said.values) do
    local name = said.format.names[i]
    if type(value) == "string" and buffers[name] then
      tree:add(buffers[name], ByteArray.new(value, true):tvb(name)())
    elseif numbers[name] then
      tree:add(numbers[name], Int64.new(value))
    end
  end
end

local function show_said(tree, said)
  local branch = tree:add(f.text, said.text)
  branch:add(f.message, said.name or said.format.name)
  if said.values and not said.format.text then
    show_values(branch, said)
  end
  if said.unknown then
    branch:add_proto_expert_info(unknown_expert)
  end
end

local function show_item(tree, pinfo, item)
  local branch = tree:add(f.kind, item.kind)
  if item.begins_in ~= pinfo.number then
    branch:add(f.begins_in, item.begins_in):set_generated()
  end
  if item.block then
    local tvb = ByteArray.new(item.block, true):tvb("Message block")
    branch:add(f.length, tvb(0, 1))
    branch:add(f.seq, tvb(1, 1), item.seq)
    if tvb:len() > BLOCK_MIN then
      branch:add(f.content, tvb(D.block.content_at, tvb:len() - BLOCK_MIN))
    end
    branch:add(f.crc, tvb(tvb:len() - 3, 2))
    branch:add(f.repeated, item.repeated or false):set_generated()
  end
  if item.repeated then
    branch:add_proto_expert_info(repeated_expert)
  elseif item.kind == "nak" then
    branch:add_proto_expert_info(nak_expert)
  elseif item.kind == "noise" then
    branch:add_proto_expert_info(noise_expert)
  end
  for _, said in ipairs(item.said) do
    show_said(branch, said)
  end
end

local function show_data(tvb, pinfo, tree, nodeid, direction, items)
  tree:add(f.nodeid, nodeid):set_generated()
  tree:add(f.direction, direction):set_generated()
  if tvb:len() > 0 then
    tree:add(f.payload, tvb())
  end
  local texts = {}
  for _, item in ipairs(items) do
    show_item(tree, pinfo, item)
    for _, said in ipairs(item.said) do
      texts[#texts + 1] = (item.repeated and "(again) " or "") .. said.text
    end
  end
  local ends = ends_in[pinfo.number]
  if ends and ends ~= pinfo.number then
    tree:add(f.ends_in, ends):set_generated()
  end
  local arrow = direction == TO and "to " or "from "
  pinfo.cols.info = arrow .. nodeid .. ": " .. (#texts > 0 and table.concat(texts, "; ") or "part of a block")
end

-- ------------------------------------------------------------------------------------ admin and signal frames

local function format_of(can_id, data)
  for _, known in ipairs(D.frames) do
    local ours = can_id >= known.can_id and can_id < known.can_id + known.ids and #data >= known.size
    if ours and (not known.command or known.command == data:byte(1)) then
      return known
    end
  end
  return nil
end

local function show_frame(tvb, pinfo, tree, known)
  local branch = tree:add(f.kind, known.kind)
  local words, values, at = { known.name }, {}, known.fields_at
  for i, name in ipairs(known.fields) do
    local field, range = D.fields[name], tvb(at, D.fields[name].size)
    if field.kind == "uuid" then
      values[i] = hex(range:raw())
      words[#words + 1] = name .. "=" .. values[i]
    else
      values[i] = range:le_uint()
      local plain = string.format(field.kind == "hex" and "0x%02x" or "%d", values[i])
      words[#words + 1] = name .. "=" .. (field.values and field.values[values[i]] or plain)
    end
    at = at + field.size
  end
  local said = branch:add(f.text, table.concat(words, " "))
  said:add(f.message, known.name)
  said:add(f.direction, known.direction):set_generated()
  said:add(f.extension, known.extension):set_generated()
  said:add(f.meaning, known.sentence):set_generated()
  at = known.fields_at
  for i, name in ipairs(known.fields) do
    said:add(f[name], tvb(at, D.fields[name].size), values[i])
    at = at + D.fields[name].size
  end
  pinfo.cols.info = table.concat(words, " ")
end

-- --------------------------------------------------------------------------------------------- the dissector

-- What this frame completes, worked out when it is seen first.
local function items_of(tvb, pinfo, can_id, nodeid, direction)
  local kept = results[pinfo.number]
  local blind = can_id_of() == nil
  if kept and not (kept.blind and not blind) then
    return kept.items
  end
  local interface = interface_of()
  local bus = of(buses, blind and "unknown" or interface and interface.value or "only", new_bus)
  local data = tvb:len() > 0 and tvb:raw() or ""
  local items = work_out(pinfo, bus, can_id, nodeid, direction, data)
  results[pinfo.number] = { items = items, blind = blind }
  return items
end

function canductor.dissector(tvb, pinfo, root)
  local can_id = pinfo.match -- the number under which the table had this dissector
  local known = format_of(can_id, tvb:len() > 0 and tvb:raw() or "")
  local nodeid = math.floor((can_id - D.first_data_id) / 2)
  local is_data = nodeid >= 1 and nodeid <= D.nodeid_max
  if not known and not is_data then
    return 0
  end
  pinfo.cols.protocol = "CANDUCTOR"
  local tree = root:add(canductor, tvb())
  if known then
    show_frame(tvb, pinfo, tree, known)
  else
    local direction = can_id % 2 == 0 and TO or FROM
    show_data(tvb, pinfo, tree, nodeid, direction, items_of(tvb, pinfo, can_id, nodeid, direction))
  end
  return tvb:len()
end

local by_id = DissectorTable.get("can.id")
for _, known in ipairs(D.frames) do
  for can_id = known.can_id, known.can_id + known.ids - 1 do
    by_id:add(can_id, canductor)
  end
end
for can_id = D.first_data_id + 2, D.first_data_id + 2 * D.nodeid_max + 1 do
  by_id:add(can_id, canductor)
end
