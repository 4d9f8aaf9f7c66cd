
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

local function begins_block(data)
  if #data < 2 then
    return false
  end
  local length, mark = data:byte(1, 2)
  return length >= BLOCK_MIN and length <= BLOCK_MAX and mark - mark % 16 == D.block.sequence_mark
end

-- Takes a frame's payload; returns what it completed.
local function feed(stream, data, now_s)
  local found = {}
  if stream.held ~= "" and now_s - stream.held_s > GAP_S and begins_block(data) then
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
